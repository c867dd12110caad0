"""What users do with the maps that rival each other: compare them, explain them, tell them apart."""
