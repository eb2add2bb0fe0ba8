"""The words everybody uses: errors, names, configuration; and values as bytes, checked and canonical."""
