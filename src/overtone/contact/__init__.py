"""How tip and sample push on each other: terms, and models as sums of terms."""
