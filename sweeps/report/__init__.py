"""Reports: documents of sections, tables, figures and notes, with one renderer for pages and one for the terminal."""
