"""Pages of run folders with their figures, and words that pages and terminal share."""

#: True to draw each figure a second time for phones, narrow and with stacked panels. Tests set it to False to save
#: time.
FOR_PHONES = True
