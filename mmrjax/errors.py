"""What is raised where a user's input comes in. Importable without jax."""


class UsageError(ValueError):
    """Wrong use of the public API; one sentence: where, what came, what is allowed."""
