"""The tables and figures of D. Dharma's thesis (Leeds, 2025) beside our own."""
