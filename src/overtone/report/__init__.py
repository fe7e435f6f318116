"""Reports for people: what they say, and how it is laid out."""
