"""English sentences on results, built once for terminal, JSON and page. Modules that compute return data."""
