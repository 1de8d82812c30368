"""What the pages say is so: links and names, the imports of the architecture, and pages that are done step by step."""
