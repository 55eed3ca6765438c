"""The paper's experiments beside ours: its numbers as data, the same tables from run folders."""
