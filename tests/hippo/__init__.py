"""The method, the core, and what every learner must do: learn, repeat itself, resume, keep its golden numbers."""
