"""Belts, grousers and contacts resolved one by one, in MJX, and pictures of them."""
