"""Calibration: what is free, how it is observed, fitted and judged."""
