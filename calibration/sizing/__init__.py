"""Sizing: checks of robots against requirements, and the search for a robot that meets them."""
