"""Studies of learning: what is compared is data, in the YAML files here; see docs/comparison.md."""
