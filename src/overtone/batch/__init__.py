"""Maps of many files, and of one file that is larger than memory."""
