"""Calibration: free parameters, observers, fits and their analysis."""
