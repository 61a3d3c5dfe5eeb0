"""Measured data and what is done with it: tables of runs, errors, and calibration by gradients."""
