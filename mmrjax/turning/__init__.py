"""Robots whose sides are driven apart."""
