"""The laws that `benchmarks/rivals.py` flies beside Keepout's: one module a rival, on one loop (`rival.Rival`)."""
