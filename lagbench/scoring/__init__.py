"""Score predictions against the truth."""
