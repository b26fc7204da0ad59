// A few threads that run numbered tasks. Which thread runs which task is not determined, so tasks write to places of
// their own and results do not depend on the number of threads.
#pragma once
#include <atomic>
#include <condition_variable>
#include <exception>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace spiked {

class Pool {
  public:
    explicit Pool(int threads);
    ~Pool();
    Pool(const Pool&) = delete;
    Pool& operator=(const Pool&) = delete;

    int threads() const { return static_cast<int>(workers_.size()) + 1; }

    // Calls work(task, thread) for every task in [0, tasks), the caller being thread 0; returns when all are done.
    // The first exception is thrown here, after the other threads have stopped.
    void run(int tasks, const std::function<void(int task, int thread)>& work);

  private:
    void stop();
    void serve(int thread);
    void take(int thread);

    std::vector<std::thread> workers_;
    std::mutex mutex_;
    std::condition_variable begin_, end_;
    uint64_t round_ = 0;
    int active_ = 0;     // workers in the round
    bool open_ = false;  // workers may still join
    bool stopping_ = false;
    const std::function<void(int, int)>* work_ = nullptr;
    int tasks_ = 0;
    std::atomic<int> next_{0};
    std::exception_ptr failure_;
};

}  // namespace spiked
