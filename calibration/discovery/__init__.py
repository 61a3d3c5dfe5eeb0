"""The closed loop: what a fitted model lacks, traced to a balance and, where one fits, to an effect."""
