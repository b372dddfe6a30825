"""Trial recoveries of some pixels: what they tell of the capture before all of it is recovered."""
