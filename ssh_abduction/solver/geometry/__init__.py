"""Fit poses to maps by least squares, and rank maps by how well they fit."""
