"""Pages of run folders, each with its figures, and the words that they and the console use."""

#: Draw each figure a second time, narrow and with its panels stacked, for phones. Tests switch it off to save time.
FOR_PHONES = True
