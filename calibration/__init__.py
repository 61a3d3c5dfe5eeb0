"""Measured data and what is done with it: records, errors, and (to come) fit, residual and effects."""
