"""Typed results of commands; commands, pages and figures import them, never the reverse."""
