"""The field's words: what an expression depicts, and whether it was rendered."""
