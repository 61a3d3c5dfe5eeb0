"""Numerical methods written out for small problems in large batches."""
