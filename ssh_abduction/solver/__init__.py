"""Every minimal map of a trace."""
