"""Write tables and figures to files and terminals; knows no experiment."""
