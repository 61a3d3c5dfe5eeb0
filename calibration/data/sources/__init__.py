"""Sources of measured data: one reader for files of every format and for tables in memory."""
