"""The leaderboard: submissions as data, one static page, every number recomputable."""
