"""What every panel is drawn with: lines and axes, colours, timelines."""
