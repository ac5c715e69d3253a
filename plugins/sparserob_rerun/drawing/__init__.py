"""Drawing tools of all panels: lines and axes, colours, timelines."""
