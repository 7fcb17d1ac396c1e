"""What becomes of results: JSON and tables, summaries, scores against the truth, arrays and pictures of every stage."""
