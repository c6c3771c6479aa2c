"""The field's words: what an expression depicts, whether it was rendered, and which view it belongs to."""
