"""Compiled functions, and programs that are kept on disk."""
