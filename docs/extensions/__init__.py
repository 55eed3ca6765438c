"""Parts of the documentation site made from the code, and its equations and notebooks."""
