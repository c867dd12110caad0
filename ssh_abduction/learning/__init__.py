"""The bootstrap loop of the paper: from images to views, a map, labels and a recogniser."""

from ssh_abduction.learning.learner import BootstrapLearner

__all__ = ["BootstrapLearner"]
