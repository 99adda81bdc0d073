"""An attack on the readers of lagbench with seeded, mutated files."""
