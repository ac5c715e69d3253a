"""What a control that answers its measurements makes of the state: innovations, gains, the closed loop."""
