"""Belts, grousers and individual contacts in MJX, and pictures of them."""
