"""The experiments of the paper (Kuipers & Beeson 2002), with their tables and figures."""
