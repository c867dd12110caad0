"""The judges of maps and bounds: plain Python that shares nothing with the encodings, so that it can catch them."""
