"""The library of effects: one file each; a file placed here is found without any other change."""
