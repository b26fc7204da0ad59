#include "pool.hpp"

namespace spiked {

Pool::Pool(int threads) {
    try {
        for (int i = 1; i < threads; ++i) workers_.emplace_back([this, i] { serve(i); });
    } catch (...) {  // no thread to be had: those that run wait on what is about to be destroyed
        stop();
        throw;
    }
}

Pool::~Pool() { stop(); }

void Pool::stop() {
    {
        std::lock_guard lock(mutex_);
        stopping_ = true;
    }
    begin_.notify_all();
    for (std::thread& worker : workers_) worker.join();
}

void Pool::run(int tasks, const std::function<void(int, int)>& work) {
    if (workers_.empty() || tasks <= 1) {
        for (int task = 0; task < tasks; ++task) work(task, 0);
        return;
    }
    {
        std::lock_guard lock(mutex_);
        work_ = &work;
        tasks_ = tasks;
        next_ = 0;
        failure_ = nullptr;
        ++round_;
        open_ = true;
    }
    begin_.notify_all();
    take(0);
    std::unique_lock lock(mutex_);
    // A worker that has not woken by now finds the round closed: on a busy machine the round does not wait for it.
    open_ = false;
    end_.wait(lock, [this] { return active_ == 0; });
    if (failure_) std::rethrow_exception(failure_);
}

void Pool::take(int thread) {
    try {
        for (int task; (task = next_.fetch_add(1, std::memory_order_relaxed)) < tasks_;) (*work_)(task, thread);
    } catch (...) {
        std::lock_guard lock(mutex_);
        if (!failure_) failure_ = std::current_exception();
        next_ = tasks_;
    }
}

void Pool::serve(int thread) {
    uint64_t seen = 0;
    for (;;) {
        {
            std::unique_lock lock(mutex_);
            begin_.wait(lock, [&] { return stopping_ || (open_ && round_ != seen); });
            if (stopping_) return;
            seen = round_;
            ++active_;
        }
        take(thread);
        std::lock_guard lock(mutex_);
        if (--active_ == 0) end_.notify_one();
    }
}

}  // namespace spiked
