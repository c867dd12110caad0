"""One page in the browser that shows what rival maps share, where they differ, and what happened at each step."""
