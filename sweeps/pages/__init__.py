"""Pages of run folders, each with its figures, and the words that they and the console use."""
