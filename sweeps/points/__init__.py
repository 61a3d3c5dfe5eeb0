"""Points of sweeps: plans and designs, their simulation, and the store with the results."""
