"""What the speed benchmark times."""
