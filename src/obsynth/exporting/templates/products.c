/* Products of tables and vectors, added to the sums of all rows, which keep their order: of tables that stand row by row,
 * of the entries that are not zero, and of tables by columns, of which four are added in one pass over the rows, so that
 * these are independent and a compiler can use vectors. Small tables alone go one row after the other (ADD_ROW). */
#define ADD_plain(table, vector, rows, columns) \
    for (i = 0; i < (rows); i++) { \
        for (j = 0; j < (columns); j++) { \
            sum[i] += table[i][j] * vector[j]; \
        } \
    }
#define ADD_entries(table, vector, rows, columns) \
    for (i = 0; i < (rows); i++) { \
        for (j = table##_start[i]; j < table##_start[i + 1]; j++) { \
            sum[i] += table##_value[j] * vector[table##_column[j]]; \
        } \
    }
#define ADD_columns(table, vector, rows, columns) \
    for (j = 0; j + 3 < (columns); j += 4) { \
        for (i = 0; i < (rows); i++) { \
            sum[i] = sum[i] + table[j][i] * vector[j] + table[j + 1][i] * vector[j + 1] \
                     + table[j + 2][i] * vector[j + 2] + table[j + 3][i] * vector[j + 3]; \
        } \
    } \
    for (; j < (columns); j++) { \
        for (i = 0; i < (rows); i++) { \
            sum[i] += table[j][i] * vector[j]; \
        } \
    }
#define ADD_ROW(table, vector, columns) \
    for (j = 0; j < (columns); j++) { \
        sum += table[i][j] * vector[j]; \
    }
#define SET(target, rows) \
    for (i = 0; i < (rows); i++) { \
        target[i] = sum[i]; \
    }
