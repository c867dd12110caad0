"""Maps from displacements: Gaussians of poses, without clingo. The caller has to check a map."""
