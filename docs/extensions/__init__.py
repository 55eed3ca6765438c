"""Parts of the documentation site made from the code: tables, and the check of docstrings."""
