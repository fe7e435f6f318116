"""What an experiment will tell, asked before it is made."""
