"""Sizing: robots held against requirements, and searched for so that they meet them."""
