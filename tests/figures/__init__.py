"""From rows to pictures and tables."""
