"""Reports: a document of sections, tables, figures and notes, with one renderer each for page and terminal."""
