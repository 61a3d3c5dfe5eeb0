"""Points of sweeps: plans and designs, what simulates them, and the store that keeps them."""
