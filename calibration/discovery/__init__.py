"""The closed loop: the model error of a fitted robot, traced to a balance and, if one fits, to an effect."""
