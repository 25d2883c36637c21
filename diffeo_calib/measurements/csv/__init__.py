"""CSV tables: cells, columns, rows, and the tables made of them."""
