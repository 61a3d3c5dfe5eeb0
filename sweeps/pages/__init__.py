"""Pages of run folders with their figures, and words that pages and terminal share."""
