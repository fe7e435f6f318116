"""What a file is worth: what was found in it, what is missing, what to ask for, and what it can give."""
