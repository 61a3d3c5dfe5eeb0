"""A calibrated drive in the formats of other simulators."""
