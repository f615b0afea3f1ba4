"""Maps of tags from recordings: start, adjustment, checks."""
