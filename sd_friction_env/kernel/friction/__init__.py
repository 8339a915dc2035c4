"""Friction laws, one file each: the coefficient mu(v_rel) in slip with its derivatives, and that of stick, mu_s."""
