"""Files in and out: one file a format behind one registry, and observables out of channels."""
