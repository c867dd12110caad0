"""Maps from views, stars and actions, without clingo. The caller has to check a map."""
