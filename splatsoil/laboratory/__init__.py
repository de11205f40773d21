"""Laboratory tests without cameras: their folders, and estimates of parameters from them."""
