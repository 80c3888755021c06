"""Training and judging the video enhancer: the commands `hsnoise train` and `hsnoise evaluate`."""
