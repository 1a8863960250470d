"""What one scan goes through: the request, the quality of its rows, and the products that are saved."""
