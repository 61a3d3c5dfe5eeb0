"""Which inputs matter: derivatives, variance-based indices, screening, and which runs would tell most."""
