"""Each baseline against its fact sheet: numbers worked by hand, and the known bugs of published code."""
