/* SPDX-License-Identifier: Apache-2.0 */
/* Makes one call of the operating system that writes below a folder fail, whichever library makes it: SQLite, Arrow,
 * torch, Python. Loaded by LD_PRELOAD; a process arms it with fail_write. What C's own FILE writes is not seen.
 * Makes the clock jump too. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/time.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

enum { FULL, IO_ERROR, TORN, CUT }; /* TORN: half is written, then an error; CUT: half is written, then a kill */

static char folder[PATH_MAX];
static atomic_long calls;
static long failing;
static int how;

/* The failing-th call from now on that writes below the folder fails; none where failing is 0. */
void fail_write(const char* below, long nth, int way) {
  snprintf(folder, sizeof folder, "%s/", below);
  failing = nth;
  how = way;
  atomic_store(&calls, 0);
}

/* Calls below the folder so far. */
long count_writes(void) { return atomic_load(&calls); }

static int fails(const char* path) {
  if (!folder[0] || !path || strncmp(path, folder, strlen(folder)) != 0) return 0;
  return atomic_fetch_add(&calls, 1) + 1 == failing;
}

static int fails_at(int file) {
  char link[32], path[PATH_MAX];
  if (!folder[0]) return 0;
  snprintf(link, sizeof link, "/proc/self/fd/%d", file);
  ssize_t length = readlink(link, path, sizeof path - 1);
  if (length < 0) return 0;
  path[length] = 0;
  return fails(path);
}

static int refuse(void) {
  if (how == CUT) raise(SIGKILL);
  errno = how == FULL ? ENOSPC : EIO;
  return -1;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define FORWARD(name, condition, ...) return condition ? refuse() : REAL(name)(__VA_ARGS__)
#define IS_TORN (how == TORN || how == CUT)

ssize_t write(int file, const void* data, size_t size) {
  if (!fails_at(file)) return REAL(write)(file, data, size);
  if (IS_TORN) REAL(write)(file, data, size / 2);
  return refuse();
}

ssize_t pwrite(int file, const void* data, size_t size, off_t at) {
  if (!fails_at(file)) return REAL(pwrite)(file, data, size, at);
  if (IS_TORN) REAL(pwrite)(file, data, size / 2, at);
  return refuse();
}

ssize_t pwrite64(int file, const void* data, size_t size, off64_t at) { return pwrite(file, data, size, at); }

ssize_t writev(int file, const struct iovec* parts, int count) {
  if (!fails_at(file)) return REAL(writev)(file, parts, count);
  if (IS_TORN) REAL(writev)(file, parts, count / 2);
  return refuse();
}

ssize_t sendfile(int to, int from, off_t* at, size_t size) {
  if (!fails_at(to)) return REAL(sendfile)(to, from, at, size);
  if (IS_TORN) REAL(sendfile)(to, from, at, size / 2);
  return refuse();
}

ssize_t sendfile64(int to, int from, off64_t* at, size_t size) { return sendfile(to, from, at, size); }
int fsync(int file) { FORWARD(fsync, fails_at(file), file); }
int fdatasync(int file) { FORWARD(fdatasync, fails_at(file), file); }
int ftruncate(int file, off_t size) { FORWARD(ftruncate, fails_at(file), file, size); }
int ftruncate64(int file, off64_t size) { return ftruncate(file, size); }
int rename(const char* from, const char* to) { FORWARD(rename, fails(to), from, to); }
int mkdir(const char* path, mode_t mode) { FORWARD(mkdir, fails(path), path, mode); }

static atomic_long jump;

/* The time of day is so many seconds off from now on. */
void jump_clock(long seconds) { atomic_store(&jump, seconds); }

int clock_gettime(clockid_t clock, struct timespec* now) {
  int result = REAL(clock_gettime)(clock, now);
  if (clock == CLOCK_REALTIME) now->tv_sec += atomic_load(&jump);
  return result;
}

int gettimeofday(struct timeval* restrict now, void* restrict zone) {
  int result = REAL(gettimeofday)(now, zone);
  now->tv_sec += atomic_load(&jump);
  return result;
}

static int open_file(const char* path, int flags, va_list rest) {
  mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(rest, mode_t) : 0;
  FORWARD(open, flags & O_CREAT && access(path, F_OK) && fails(path), path, flags, mode);
}

int open(const char* path, int flags, ...) {
  va_list rest;
  va_start(rest, flags);
  int file = open_file(path, flags, rest);
  va_end(rest);
  return file;
}

int open64(const char* path, int flags, ...) {
  va_list rest;
  va_start(rest, flags);
  int file = open_file(path, flags | O_LARGEFILE, rest);
  va_end(rest);
  return file;
}
