"""English of what was computed, made here once for terminal, JSON and page: rooms that compute return data."""
