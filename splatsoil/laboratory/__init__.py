"""Tests of a laboratory without cameras: folders that hold them, and the parameters they tell."""
