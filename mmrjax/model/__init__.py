"""Drive, load, ground and instruments of a robot, and the balances that sum their terms."""
