"""Parts of ``splatsoil benchmark validate``: each compares the soil with an exact answer or with a laboratory."""
