"""What people are made of: a skinned body, its surface, and corrections of its poses."""
