"""The laboratory: captures with known truth, benchmarks, and the training of what is learned."""
