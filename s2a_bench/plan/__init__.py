"""What the answer means: skills, output formats, the grammar that holds a model to them, and the parser."""
