"""Runs side by side: results, aggregates, tables, pages."""
