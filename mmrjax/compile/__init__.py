"""Compiled functions, and programs stored on disk."""
