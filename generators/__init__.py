"""The material-point solver and the splits that it simulates."""
