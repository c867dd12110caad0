"""The topological level of a building: paths, corridors, doors and rooms of a finished map."""
