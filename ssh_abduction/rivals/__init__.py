"""What users do with the minimal maps of a trace: compare them, and see what they share."""
