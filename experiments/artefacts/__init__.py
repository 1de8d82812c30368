"""What makes the committed pages, tables, pictures and rows that no training run makes: a command per artefact."""
