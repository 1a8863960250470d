"""A folder of products: written whole or not at all, and read back."""
