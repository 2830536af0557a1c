"""How well poses are found: pairs of an image and a guess, methods that answer them, scores of the answers."""
