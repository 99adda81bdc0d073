"""Make data sets: generate, verify, describe."""
