"""Robots with independently driven sides."""
