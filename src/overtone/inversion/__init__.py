"""From force harmonics to material properties: one file a method, one result type."""
