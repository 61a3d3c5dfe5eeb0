"""Data from outside: tables of runs, noise, robot and effect files, and the checks at the door."""
