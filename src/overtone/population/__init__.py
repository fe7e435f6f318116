"""The pixels of a whole scan together: phases, the materials they are made of, and what that says of each pixel."""
