"""What a network would have answered: observations without images."""
