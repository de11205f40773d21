"""Measurements of the product itself: accuracy, honesty, speed."""
