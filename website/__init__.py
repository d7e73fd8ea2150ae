"""What the site of the documentation needs beside its generator; see `make docs`."""
