"""Sensitivity: derivatives, variance-based indices, screening, and the most informative next runs."""
