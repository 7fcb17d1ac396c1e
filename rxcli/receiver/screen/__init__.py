"""Where the screen is: a frame to corners, column outlines and the sensor row of every place."""
