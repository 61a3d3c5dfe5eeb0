"""English sentences of notes and results: the one place below the commands that writes them."""
