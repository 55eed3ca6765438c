"""What the documentation site makes from the code: tables, and the check of the docstrings."""
