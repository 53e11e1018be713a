/* A factor in single precision by MUMPS, for one process: see single.py. */
#include <smumps_c.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum { INITIALISE = -1, END = -2, ANALYSE = 1, FACTORISE = 2, SOLVE = 3, SLACK = 65536 };

/* A factor, or NULL if the library is not the one that the header is of. */
void* begin(int symmetric, int comm)
{
  SMUMPS_STRUC_C* s = calloc(1, sizeof(SMUMPS_STRUC_C) + SLACK);
  if (!s) return NULL;
  s->sym = symmetric ? 2 : 0;
  s->par = 1;
  s->comm_fortran = comm;
  s->job = INITIALISE;
  smumps_c(s);
  if (s->infog[0] < 0 || strncmp(s->version_number, MUMPS_VERSION, strlen(MUMPS_VERSION)) != 0) {
    free(s);
    return NULL;
  }
  for (int i = 0; i < 4; ++i) s->icntl[i] = i == 3 ? 0 : -1; /* nothing is printed */
  s->icntl[12] = 1;                                          /* no ScaLAPACK, which counts no negative pivots */
  return s;
}

/* Factorise with entries numbered from one; the structure is analysed if asked for. Returns MUMPS's status. */
int factorise(void* factor, int n, int64_t entries, int* rows, int* columns, float* values, int room, int analyse)
{
  SMUMPS_STRUC_C* s = factor;
  s->n = n;
  s->nnz = entries;
  s->irn = rows;
  s->jcn = columns;
  s->a = values;
  s->icntl[13] = room;
  if (analyse) {
    s->job = ANALYSE;
    smumps_c(s);
    if (s->infog[0] < 0) return s->infog[0];
  }
  s->job = FACTORISE;
  smumps_c(s);
  s->irn = s->jcn = NULL;
  s->a = NULL;
  return s->infog[0];
}

/* Solve in place for `count` right-hand sides, one after the other. */
int solve(void* factor, float* rights, int count, int transpose)
{
  SMUMPS_STRUC_C* s = factor;
  s->rhs = rights;
  s->nrhs = count;
  s->lrhs = s->n;
  s->icntl[8] = transpose ? 2 : 1;
  s->icntl[26] = count; /* all at once */
  s->job = SOLVE;
  smumps_c(s);
  s->rhs = NULL;
  return s->infog[0];
}

int told(void* factor, int number)
{
  return ((SMUMPS_STRUC_C*)factor)->infog[number - 1];
}

void end(void* factor)
{
  SMUMPS_STRUC_C* s = factor;
  s->job = END;
  smumps_c(s);
  free(s);
}
