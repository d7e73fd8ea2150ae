"""Write an HTML report of a recorded session (`flexsheet bag report`)."""
