"""How functions written by hand are differentiated and batched when JAX traces them."""
