"""What a command found, typed: commands, pages and figures import it, and it none of them."""
